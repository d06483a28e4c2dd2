"""The tensors of a scene and of its BRDFs: compressed, movable to a device, saved and loaded."""
