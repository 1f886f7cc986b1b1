"""The main job: the paper's CNR tables, by FBP and PWLS, with intervals, beside the paper's numbers."""
