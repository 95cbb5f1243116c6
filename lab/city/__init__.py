"""Synthetic city generator: renders labelled datasets for tests, benchmarks and demos.

The pipeline: `streets` lays out quarters and view points, `plan` decides which photos are taken and
when; `catalogue` draws the parts that all houses share, `houses` arranges them into facades;
`camera` casts rays, `scene` places street objects, `render` renders one view, and `postprocess`
applies the light and weather of its session. `write` renders on all cores and writes a dataset.

Places differ in the arrangement of parts, not in their palette. So colour statistics don't identify
a place, and descriptors have to recognise structure.
"""
