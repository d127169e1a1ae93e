"""Read and write the files of each kind of folder as typed values; the JSON Schemas are generated from the types."""
