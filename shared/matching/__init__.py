"""Local features: keypoints with descriptors, their matches, and the verification of matches.

`features` is the stored form, `xfeat` computes it (torch), `mutual_nearest` pairs the keypoints of
two photos (NumPy), and `verification` tells which pairs agree with one camera motion.
"""
