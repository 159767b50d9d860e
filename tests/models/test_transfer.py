"""Transfer functions: closed forms, exact inverses, and gradients that stay finite."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from models.errors import ConfigError
from models.transfer import Transfer, mu_law_forward, srgb_forward, srgb_inverse

TRANSFERS = [Transfer(), Transfer(curve="log1p"), Transfer(mu=500.0)]


@pytest.mark.parametrize("transfer", TRANSFERS)
@given(x=st.floats(0.0, 6.5e4, width=32))
def test_transfer_inverse_undoes_forward(transfer: Transfer, x: float) -> None:
    value = torch.tensor(x, dtype=torch.float64)
    assert transfer.inverse(transfer.forward(value)).item() == pytest.approx(x, rel=1e-9, abs=1e-12)


def test_mu_law_maps_black_and_white_to_themselves() -> None:
    y = mu_law_forward(torch.tensor([0.0, 1.0, 3.0], dtype=torch.float64), mu=16.0)
    assert y.tolist() == pytest.approx([0.0, 1.0, math.log(49.0) / math.log(17.0)])


def test_log1p_is_the_papers() -> None:
    assert Transfer(curve="log1p").forward(torch.tensor(math.e - 1.0)).item() == pytest.approx(1.0)


@pytest.mark.parametrize("transfer", TRANSFERS)
def test_transfer_clamps_negative_and_passes_nan(transfer: Transfer) -> None:
    value = torch.tensor([-2.0, math.nan])
    for function in (transfer.forward, transfer.inverse, transfer.display):
        result = function(value)
        assert result[0] == 0.0
        assert result[1].isnan()


def test_srgb_has_its_published_values() -> None:
    y = srgb_forward(torch.tensor([0.0, 0.0031308, 0.18, 0.5, 1.0, 7.0], dtype=torch.float64))
    assert y.tolist() == pytest.approx([0.0, 0.04045, 0.461356, 0.735357, 1.0, 1.0], abs=1e-5)


def test_srgb_inverse_undoes_forward() -> None:
    x = torch.linspace(0.0, 1.0, 4001, dtype=torch.float64)
    assert torch.allclose(srgb_inverse(srgb_forward(x)), x, atol=1e-7)


@pytest.mark.parametrize("transfer", TRANSFERS)
def test_display_equals_srgb_of_clipped_radiance(transfer: Transfer) -> None:
    x = torch.tensor([0.0, 1e-4, 0.2, 0.9, 1.0, 40.0], dtype=torch.float64)
    assert torch.allclose(transfer.display(transfer.forward(x)), srgb_forward(x), atol=1e-9)


@pytest.mark.parametrize("transfer", TRANSFERS)
def test_display_of_wild_output_has_finite_value_and_gradient(transfer: Transfer) -> None:
    encoded = torch.tensor([-1e4, 0.0, 1e-8, 0.5, 1e4], requires_grad=True)
    display = transfer.display(encoded)
    display.sum().backward()
    assert encoded.grad is not None
    assert display.isfinite().all()
    assert encoded.grad.isfinite().all()
    assert encoded.grad[3] > 0.0


@pytest.mark.parametrize("values", [{"curve": "gamma"}, {"mu": 0.0}, {"mu": math.nan}])
def test_transfer_rejects_values_outside_its_rules(values: dict) -> None:
    with pytest.raises(ConfigError):
        Transfer(**values)
