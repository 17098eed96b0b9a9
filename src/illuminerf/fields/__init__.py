"""Neural fields: encodings, surface and appearance, volume rendering, losses, meshing.

Vocabulary: `rays` share a leading axis; a ray's `edges` bound its `samples` (intervals); `weights` are the volume
rendering weights of the samples; `density normals` are gradients of the signed distance, `predicted normals` come
from their own hash grid. Positions live in the unit ball, colours are sRGB values premultiplied on black.
"""
