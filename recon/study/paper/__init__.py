"""What the paper says (``facts``, ``tables``) and how its plaque is scanned and read (``plaque_scan``, ``measures``)."""
