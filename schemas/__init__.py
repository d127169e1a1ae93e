"""JSON Schemas and pages of the folder formats."""
