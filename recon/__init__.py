"""Reconstruction: FBP, PWLS, MBIR."""
