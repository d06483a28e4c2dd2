"""Files: images, and saved tensors."""
