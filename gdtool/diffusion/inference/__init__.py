"""Sample views from a picture and turn the sampled images into a views folder's content."""
