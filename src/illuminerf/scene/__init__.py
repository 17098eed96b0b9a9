"""The nouns every stage speaks: cameras, images, environment maps, meshes, views.

World axes are z-up; cameras are OpenGL (x right, y up, looking along -z). Colour spaces are in the names:
`linear_rgb` is rec.709 radiance, `srgb` is display-coded. See docs/conventions.md.
"""
