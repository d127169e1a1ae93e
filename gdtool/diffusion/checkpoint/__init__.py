"""Load and save model folders, and convert foreign weights (Stable Diffusion, Wonder3D)."""
