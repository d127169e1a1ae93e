"""Provide the multi-view PBR diffusion model: configuration, network, data, training, inference and reports."""
