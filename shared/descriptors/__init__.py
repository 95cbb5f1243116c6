"""From a photo's bytes to its global descriptor. torch lives here and nowhere else in `shared`.

bytes --decode, preprocessing--> RGB pixels --backbone--> dense local features --aggregator--> row

`decode`, `preprocessing` and `resample` import no torch: they run in the decoding child processes.
"""
