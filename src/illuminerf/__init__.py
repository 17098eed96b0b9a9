"""Open IllumiNeRF: relightable view synthesis without inverse rendering.

Photographs of an object under one unknown light go in; the same object, from any side, under any light, comes
out. `illuminerf.pipeline` holds the whole method on one page.
"""

__version__ = "0.1.0"
