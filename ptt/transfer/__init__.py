"""Scene -> raw transfer (rays) -> tensors of every point -> clusters: all that is done once, before relighting."""
