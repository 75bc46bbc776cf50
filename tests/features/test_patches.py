import numpy as np

from fmtorch.features import ImagePyramid


def test_pixel_x_of_a_level_is_pixel_2x_of_the_finer_one() -> None:
    y, x = np.mgrid[0:100, 0:150]
    ramp = (x + y).astype(np.uint8)
    for level, image in enumerate(ImagePyramid(ramp).levels):
        inner = image[3:-3, 3:-3] if min(image.shape) > 8 else image[:0]
        expected = ramp[:: 2**level, :: 2**level][3:-3, 3:-3][: len(inner)] / 255
        np.testing.assert_allclose(inner, expected, rtol=1e-5, atol=1e-6)
