"""Networks of single pixels are linear layers of frames with their rows and columns."""

import pytest
import torch

from forbes.errors import ForbesError
from forbes.models import PixelDecoder, PixelEncoder

SHAPE = (1, 3, 4)


def frames():
    """None, then each pixel alone: (13, 1, 3, 4)."""
    pixels = torch.eye(12, dtype=torch.float64).view(12, *SHAPE)
    return torch.cat((torch.zeros_like(pixels[:1]), pixels))


def test_the_lookup_is_linear_in_pixels_rows_and_columns():
    torch.manual_seed(0)
    encoder, frame = PixelEncoder(SHAPE, width=5).double(), frames()
    torch.nn.init.normal_(encoder.bias)

    read = torch.cat((frame.flatten(1), frame.sum(-1).flatten(1), frame.sum(-2).flatten(1)), 1)  # (13, 12 + 3 + 4)
    weight = torch.cat((encoder.pixel.weight, encoder.row.weight, encoder.column.weight))  # (19, 5)

    torch.testing.assert_close(encoder(frame), (read @ weight + encoder.bias).relu())


def test_a_logit_is_that_of_its_pixel_row_and_column():
    torch.manual_seed(0)
    decoder, y = PixelDecoder(6, SHAPE, width=5, blocks=2).double(), torch.rand(7, 5).double()
    decoder.first, decoder.blocks, decoder.norm = torch.nn.Identity(), torch.nn.ModuleList(), torch.nn.Identity()

    logits = decoder(y)  # (7, 1, 3, 4)

    for i in range(3):
        for j in range(4):
            parts = (decoder.pixel(y)[:, 4 * i + j], decoder.row(y)[:, i], decoder.column(y)[:, j])
            torch.testing.assert_close(logits[:, 0, i, j], sum(parts))


@pytest.mark.parametrize("shape", [(3, 4, 4), (5,)])
def test_other_observations_are_refused(shape):
    for build in (lambda: PixelEncoder(shape), lambda: PixelDecoder(6, shape)):
        with pytest.raises(ForbesError, match=r"expected \(1, H, W\)\. Use MLP"):
            build()
