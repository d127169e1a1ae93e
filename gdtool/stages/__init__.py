"""Declare the stages: each turns folders into arrays, calls the packages that compute, and writes a folder."""
