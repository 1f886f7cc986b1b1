"""The coronary plaque of the paper, and its variants."""
