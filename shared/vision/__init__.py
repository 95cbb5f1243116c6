"""From a photo's bytes to its global descriptor. torch lives here and nowhere else in `shared`.

bytes --decode--> RGB pixels (uint8) --backbone--> dense local features --aggregator--> one row

`decode` and `preprocessing` import no torch: they run in the decoding child processes.
"""
