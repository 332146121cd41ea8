"""What the other process does: compile kernels for the types that stages call them with."""

from numba.core.types import Array, boolean, float32, float64, int64, npy_rng, uint16, uint32

from pixcal.estimators.crosstalk import covariance, steady
from pixcal.kernels import (
    boundaries,
    normals,
    pair_sums,
    residual_sums,
    robust,
    sample_sums,
    synthesis,
    tracks,
    two_way,
)

F1, F2, F3, F4 = (Array(float32, n, "C") for n in (1, 2, 3, 4))
D1, D2, D3 = (Array(float64, n, "C") for n in (1, 2, 3))
I1, I2 = (Array(int64, n, "C") for n in (1, 2))
MASK, CODES = Array(boolean, 2, "C"), Array(uint16, 2, "C")

# In the order in which a diagnosis calls them. Those of the fit and before are missing: the run
# compiles these meanwhile. So are those of any type of raw samples.
KERNELS = (
    (residual_sums._sum, (F3, F3, F2, F2, MASK, F2, F3, F1, I2, float32, D2)),
    (tracks.add_tracks, (F2, D2, float64, int64)),
    (two_way._project, (F2, F2, F2, F3, F2, F3, int64)),
    (boundaries._push, (F2, D2, F2, F2, F2)),
    (boundaries._share, (F3, F3, F3, F2, F2, int64, int64, F3)),
    (steady._add, (F3, I1, F3, F3, I2, F4, F4)),
    (pair_sums._sum, (F3, F3, F3, F3, F3, F3, F3, int64, int64, int64, D2)),
    (covariance._multiply_up, (F3, F3, F3, int64, F4)),
    (covariance._add_right_sums, (F3, F3, F3, I2, F4)),
    (boundaries._move, (F3, D2, float32, F3)),
    (covariance._add_normal_sums, (F3, F3, F3, F3, F3, I2, F4)),
    (sample_sums._calm, (F3, F3, F2, F2, MASK, float64, D1, F3, F3, D1, D2)),
    (sample_sums.pixel_moments, (F3,)),
    (sample_sums.neighbour_products, (F3, F3, I2, int64)),
    (sample_sums.level_sums, (F3, MASK, float64, float64, F3, F3, D2)),
    (sample_sums.products_by_level, (F3, F3, float32, F3, I2, int64)),
    (sample_sums.count_beyond, (F3, F3, MASK, D1)),
    (robust._medians_around, (F2, int64, F2)),
    (sample_sums.frame_means, (F3, MASK)),
    (synthesis.fill_normal, (npy_rng, F2)),
    (synthesis.illuminate, (F2, F2, F2, float64, float64, F2, F2, F2)),
    (normals._fill, (uint32, uint32, uint32, int64, F4)),
    (synthesis.collect, (F2, F2, F2, boolean, float64, F2)),
    (synthesis.amplify, (F2, F2, F2, F2, F2, F2)),
    (synthesis.convert, (F2, int64, int64, CODES)),
)


def compile_all() -> None:
    """Compile what is not kept yet."""
    # The last first: in their order, a run that catches up would compile each at the same time.
    for kernel, types in reversed(KERNELS):
        kernel.compile(types)


if __name__ == "__main__":
    compile_all()
