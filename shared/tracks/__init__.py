"""Tracks: follow a camera through a map, from the photos it takes one after the other.

`evidence` says what one frame shows, `motion` how far a camera moves between two frames,
`photo_graph` which photos of the map are near each other. `filter` combines them into a `belief`,
frame by frame; `state` reads position, place and status from it.
"""
