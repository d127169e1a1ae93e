"""Read and write the files of each kind of folder, typed; the JSON Schemas are generated from the types."""
