"""How a photo comes in: the same for one upload and for each photo of a batch.

`received` watches its bytes while they go into the object store, `incoming` checks what lies there,
`store_photo` makes its row and its job. `manifest` reads what lists say of many photos.
"""
