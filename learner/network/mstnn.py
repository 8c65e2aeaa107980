"""MSTNN: the vision pathway V_I > V_F > V_S (paper, eq. (3) and (4)), whole sequences at once.

A subnet gets input from the subnet below only, so the convolutions of all steps of all sequences
are computed together, and the leaky integration over the steps follows. Both are compiled where a
compiler is found. Elsewhere PyTorch computes them, the integration as a product with a triangular
matrix.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from learner.kernels import maps as maps_kernel
from learner.network.subnets import ACTIVATION_GAIN, ACTIVATION_SLOPE, Subnet


class Maps(nn.Module):
    """A subnet of feature maps (V_F, V_S).

    Attributes:
        kernel: (maps, maps below, height, width).
        bias: (maps,).
    """

    kernel: Tensor
    bias: Tensor

    def __init__(self, subnet: Subnet) -> None:
        super().__init__()
        if subnet.stride is None:
            raise ValueError(f"{subnet.name} is not convolutional")
        self.stride = subnet.stride
        self.tau = subnet.tau
        for name, shape in subnet.parameters.items():
            self.register_parameter(name, nn.Parameter(torch.zeros(shape)))

    def forward(self, below: Tensor) -> Tensor:
        """Activity (B, T, maps, height, width) for that of the subnet below, shaped alike."""
        if maps_kernel.supports(below):
            return maps_kernel.maps(below, self.kernel, self.bias, self.stride, self.tau)
        return self.reference(below)

    def reference(self, below: Tensor) -> Tensor:
        """`forward` in PyTorch; it defines what the compiled kernel computes."""
        batch, steps = below.shape[:2]
        drive = _convolve(below.flatten(0, 1), self.kernel, self.bias, self.stride)
        potentials = leaky_integral(drive.view(batch, steps, -1), self.tau)
        return activation(potentials).view(batch, steps, *drive.shape[1:])


def activation(potentials: Tensor) -> Tensor:
    """f(x) = 1.7159 tanh(2/3 x), eq. (2) and (4)."""
    return ACTIVATION_GAIN * torch.tanh(ACTIVATION_SLOPE * potentials)


def leaky_integral(drive: Tensor, tau: float) -> Tensor:
    """Potentials (B, T, F) of leaky integrators at rest before the first step.

    u[t] = (1 - 1/tau) u[t-1] + 1/tau drive[t] has the solution
    u[t] = sum over s <= t of 1/tau (1 - 1/tau)^(t-s) drive[s].
    """
    steps = torch.arange(drive.shape[1], device=drive.device)
    ages = steps[:, None] - steps[None, :]
    memory = (1 - 1 / tau) ** ages.clamp(min=0).to(drive.dtype) / tau
    return torch.matmul(memory.tril(), drive)


def _convolve(images: Tensor, kernel: Tensor, bias: Tensor, stride: int) -> Tensor:
    """Strided convolution without padding.

    Where the stride divides all sizes, pixels are first sorted into channels, which gives the same
    sums 1.7 times as fast.
    """
    sizes = (*images.shape[-2:], *kernel.shape[-2:])
    if all(size % stride == 0 for size in sizes):
        sorted_images = functional.pixel_unshuffle(images, stride)
        sorted_kernel = functional.pixel_unshuffle(kernel, stride)
        return functional.conv2d(sorted_images, sorted_kernel, bias)
    return functional.conv2d(images, kernel, bias, stride)
