"""Synthetic city generator: renders labelled data sets for tests, benchmarks and demos.

`streets` lays out quarters and view points, `plan` decides which photos are taken, when, and by
which `camera`. `houses` and `objects` draw textures from the style of a city; `scene` places them
as textured parallelograms at fixed positions, `raster` draws a view, and `light` makes a photo of
it in the light and weather of its session. `write` renders on all cores and writes a data set.
`round_trip` plans photos and queries around one block, for poses.

Places differ in the arrangement of parts, not in their palette. So colour statistics don't identify
a place, and descriptors have to recognise structure.
"""
