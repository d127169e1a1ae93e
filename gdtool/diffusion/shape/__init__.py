"""Predict an object's shape from its picture as a volume of occupancies, and render the volume to the rig's views."""
