"""Word weights: weights of a VLAD vocabulary's words, fitted on the map's own places.

VLAD's score is a sum over the words (cluster centres): cos(q, d) = sum over k of <q_k, d_k>. Photos
of the map with known places show which of these products are larger for photos of the same place
than for photos of different places. A weight per word emphasises these words. Only the query is
multiplied by the weights, so stored descriptors stay valid and any exact search can use them.

`training_pairs` samples pairs of photos, `weights` computes weights and tests whether they improve
recall, `record` is what a generation stores.
"""
