"""Radiance at points -> image: what pixels see, texels, bump maps, pictures and the errors between them."""
