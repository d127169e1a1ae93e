"""Make texture coordinates: find charts (`segment/`), flatten them (`parameterize/`), pack them (`pack/`).

`pipeline.unwrap` is the entry. Nothing is imported here: the stages name the module they need, so that `--help` stays
quick.
"""
