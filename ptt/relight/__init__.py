"""The relighting equation, step by step: light, BRDF, view; and the three relighters that are made of these steps."""
