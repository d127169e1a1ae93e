"""Run stages: manifests, sources, outputs, errors, limits, child processes. Imports no numpy, torch or click."""
