"""
First
=====
"""
import numpy as np
