"""From a scene and a scanner to a scan."""
