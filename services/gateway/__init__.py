"""The HTTP API. Stateless: no torch, no vectors, no local files.

`receive` takes a body apart as a stream, `photo_header` checks what came, `store_photo` makes it
true; `find_similar` asks the search tier. One module of routes per noun.
"""
