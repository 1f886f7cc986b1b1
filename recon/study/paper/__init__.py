"""What the paper states (``published``); its plaque scan and measurements (``plaque_scan``)."""
