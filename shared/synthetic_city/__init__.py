"""A made-up city that is drawn: streets in real metres, one catalogue of parts, sessions of days.

The way through it: `streets` lays out quarters, `places` finds spots along them and `plan` decides
which photos are taken there and when; `catalogue` draws the parts that all houses share, `house`
arranges them and `facade` draws the arrangement; `camera` casts rays, `scene` places what stands in
the street, `render` paints one view on a `canvas` and `develop` gives it its session's light.
`write` does this on all cores and leaves a data set.

A place is known by the ARRANGEMENT of parts, never by its palette: that is what makes it hard for
descriptors of colour, and possible for those that see structure.
"""
