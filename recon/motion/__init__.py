"""Motion of an inset, estimated from its own scan, with an interval and a test.

What lies in the inset moves rigidly along a smooth path; its exterior is known and stands still.
The path is found together with the volume by variable projection
(:mod:`recon.variable_projection`): FBP along the present path gives the volume, the derivatives of
its projections by the displacement in every view are what the path does to the readings, and what
another volume would explain of them is taken off.

**Start.** The centre of mass of what is left when the exterior is taken off moves on the detector
as the inset does, whatever the inset looks like (the first of the consistency conditions of
Helgason and Ludwig). A path fitted to it does not sit in the local minimum of no motion.

**What a turn holds.** A view sees the displacement across its rays, not along them. What a path
does along the rays of every view is determined by its smoothness alone: a Gaussian prior on speed
and acceleration. How large the motion is and whether it goes to and fro along a line is estimated
by the marginal likelihood (MacKay 1992, Neural Comput. 4:415), seldom for certain: path and
errors are means over all sizes and directions, each as likely as the readings make it (Bayesian
model averaging, Hoeting et al. 1999, Stat. Sci. 14:382). The one likeliest prior would take a line
for certain and state errors along the rays that are several times too small. A constant
displacement is another volume; the path's mean is zero.

**A jump** is no smooth path, but one that differs along the rays often explains its readings, and
is then wrong by as much as the jump. Paths that may jump at one view, too, are compared with the
smooth ones by their marginal likelihood: a smooth path that does what a jump does is large and
bent, and therefore less likely.

**Voxels** of the working grid are no larger than a detector cell as it is seen at the inset. What
larger ones cannot show looks like motion along the rays, and is more than the noise.
"""

from recon.motion.estimate import estimate_motion, path_of
from recon.motion.path import InsetMotion, Jump, PathTooLongError, path_figure, path_table

__all__ = [
    "InsetMotion",
    "Jump",
    "PathTooLongError",
    "estimate_motion",
    "path_figure",
    "path_of",
    "path_table",
]
