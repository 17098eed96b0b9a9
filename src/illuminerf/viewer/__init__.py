"""`illuminerf view`: a finished run in the browser."""
