"""Values by hand, and who gets a gradient from the asymmetric normal loss."""

import pytest
import torch

from illuminerf.fields import losses


def _inputs() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(6, generator=generator).requires_grad_()
    normals = torch.randn(6, 3, generator=generator).requires_grad_()
    predicted = torch.randn(6, 3, generator=generator).requires_grad_()
    return weights, normals, predicted


@pytest.mark.parametrize("party", [0, 1, 2])
def test_each_lambda_reaches_one_party_only(party: int) -> None:
    inputs = _inputs()
    lambdas = [0.0, 0.0, 0.0]
    lambdas[party] = 1.0
    losses.predicted_normal_loss(*inputs, 2, tuple(lambdas)).backward()
    for number, tensor in enumerate(inputs):
        reached = tensor.grad is not None and float(tensor.grad.abs().sum()) > 0
        assert reached == (number == party)


def test_predicted_normal_loss_value_and_gradients() -> None:
    weights, normals, predicted = _inputs()
    loss = losses.predicted_normal_loss(weights, normals, predicted, 2, (0.1, 0.2, 0.4))
    squared = ((normals - predicted) ** 2).sum(-1)
    torch.testing.assert_close(loss, 0.7 * (weights * squared).sum() / 2)
    loss.backward()
    torch.testing.assert_close(weights.grad, 0.1 * squared.detach() / 2)
    towards = (weights[:, None] * (normals - predicted)).detach()
    torch.testing.assert_close(normals.grad, 0.2 * towards)
    torch.testing.assert_close(predicted.grad, -0.4 * towards)


def test_default_lambdas_are_the_papers() -> None:
    weights, normals, predicted = _inputs()
    default = losses.predicted_normal_loss(weights, normals, predicted, 1)
    torch.testing.assert_close(
        default, losses.predicted_normal_loss(weights, normals, predicted, 1, (1e-3, 1e-3, 1e-2))
    )


def test_eikonal() -> None:
    assert float(losses.eikonal_loss(torch.tensor([[1.0, 0, 0], [0, 3.0, 0]]))) == pytest.approx(2.0)


def test_orientation_counts_back_faces_only() -> None:
    weights = torch.tensor([0.5, 0.5])
    normals = torch.tensor([[0.0, 0, 1], [0.0, 0, -1]])
    directions = torch.tensor([[0.0, 0, 1], [0.0, 0, 1]])
    assert float(losses.orientation_loss(weights, normals, directions, 1)) == pytest.approx(0.5)


def test_smoothness_and_mask() -> None:
    same = torch.ones(2, 3)
    assert float(losses.normal_smoothness_loss(torch.ones(2), same, same, 1)) == 0
    assert float(losses.normal_smoothness_loss(torch.ones(2), same, same + 1, 2)) == pytest.approx(3.0)
    alpha = torch.tensor([1.0, 0.0])
    right = losses.mask_loss(torch.tensor([50.0, 0.0]), alpha)
    wrong = losses.mask_loss(torch.tensor([0.0, 50.0]), alpha)
    assert float(right) < 1e-6 < 1 < float(wrong)


def test_an_opaque_ray_before_the_background_still_gets_a_gradient() -> None:
    depth = torch.tensor([60.0], requires_grad=True)
    losses.mask_loss(depth, torch.tensor([0.0])).backward()
    assert float(depth.grad) > 0.01
    opacity = (1 - torch.exp(-depth.detach())).requires_grad_()
    assert float(opacity.detach()) == 1.0  # which is why opacity itself cannot carry it


def test_psnr() -> None:
    assert float(losses.psnr(torch.tensor(0.01))) == pytest.approx(20.0)
