"""Photo ingestion, the same for single uploads and for each photo of a batch.

`validation` checks the bytes while they are written to the object store and reads the header,
`photo_metadata` parses form fields and manifests, `store_photo` inserts the photo and its job.
"""
