"""Word weights: which words of a vocabulary tell the map's own places apart.

VLAD's score is a sum over the words, its clusters: cos(q, d) = sum over k of <q_k, d_k>. Photos of
the map whose places are known show which of these products are larger for one place than for two;
a weight for each word makes those count. Weights multiply the query alone, so that stored rows stay
what they are, and any exact search ranks by them.

`pairs` says which photos teach, `learn` what follows from their rows, `compare` whether it helps,
`record` what is kept with a generation.
"""
