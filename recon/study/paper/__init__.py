"""What the paper says (``facts``); how its plaque is scanned and read (``plaque_scan``)."""
