"""Declare the stages: each turns folders into arrays, calls the rooms, and writes a folder."""
