"""Poses: cameras, frames, models of a map as localising reads them, and robust absolute poses.

`component` is the stored form of a model, `localise` finds the pose of a photo in it from matches
(`absolute_pose`), and `radius` turns that into coordinates with calibrated radii (`frames`). Needs
NumPy and poselib only; models are made by `services.extractor.geometry`.

Axes of a camera, as those of COLMAP and OpenCV: x to the right, y down, z forward. Pixels have
their origin in the upper left corner of the upright photo.
"""
