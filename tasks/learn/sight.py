# pyright: reportMissingImports=false
"""An actor that sees: what an encoder says of a picture goes into the memory beside the sensors.

The encoder keeps places: a spatial soft-argmax says of each feature where in the picture it is
(Levine et al. 2016, 10.48550/arXiv.1504.00702). `policy.encode` is the same in NumPy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from rsl_rl.models import RNNModel
from rsl_rl.modules import RNN
from tensordict import TensorDict
from torch import nn

from .policy import FINE, STRIDE

PICTURES = "pictures"  # group of observations
CHANNELS, KERNELS = (16, 32, 32), (5, 3, 3)  # of the convolutions
# Factors on the first weights: a feature is somewhere, not everywhere, from the start.
_CONTRAST = {0: 6.0, len(KERNELS) - 1: 4.0}
SAID = 64  # numbers that the encoder says


class Encoder(nn.Module):
  """What is seen where in a picture."""

  def __init__(self, size: Sequence[int]):
    """Makes an encoder of pictures of a height and width [pixels]."""
    super().__init__()
    self.size = tuple(size)
    channels = zip((3, *CHANNELS), CHANNELS, KERNELS, strict=False)
    self.convolutions = nn.ModuleList(
      nn.Conv2d(*sizes, stride=1 if k else STRIDE) for k, sizes in enumerate(channels)
    )
    for k, layer in enumerate(self.convolutions):
      nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
      layer.weight.data *= _CONTRAST.get(k, 1.0)
      nn.init.zeros_(layer.bias)
    self.head = nn.Linear(3 * CHANNELS[-1], SAID)
    left = sum(kernel - 1 for kernel in KERNELS[1:])
    rows, columns = ((n - KERNELS[0]) // STRIDE + 1 - left for n in size)
    down, across = (torch.linspace(-1.0, 1.0, n) for n in (rows, columns))
    columns_of = [across.repeat(rows), down.repeat_interleave(columns), torch.ones(rows * columns)]
    self.register_buffer("places", torch.stack(columns_of, dim=1), persistent=False)

  @property
  def layers(self) -> list[Any]:
    """The layers as `policy.Policy` has them."""
    return [*self.convolutions, self.head]

  def forward(self, pixels: torch.Tensor) -> torch.Tensor:
    """Returns what it says of pictures (..., 3 height width) of bytes  (..., SAID)."""
    x = pixels.reshape(-1, *self.size, 3).permute(0, 3, 1, 2).float() / 255.0 - 0.5
    learns = x.is_cuda and torch.is_grad_enabled()  # half the memory and the time
    with torch.autocast(x.device.type, torch.bfloat16, enabled=learns):
      for k, layer in enumerate(self.convolutions):
        x = layer(x.relu() if k else x)
    flat = x.flatten(2).float()
    most = flat.amax(dim=2, keepdim=True).detach()
    across, down, total = ((flat - most).exp() @ self.places).unbind(dim=2)
    level = most.squeeze(2) + (total / len(self.places)).log()
    said = self.head(torch.cat([across / total, down / total, level], dim=1)).tanh()
    return said.reshape(*pixels.shape[:-1], SAID)


class Sensing(RNNModel):
  """A recurrent actor that sees some of its observations on a finer scale too."""

  def __init__(
    self,
    seen: TensorDict,
    sets: Mapping[str, Sequence[str]],
    name: str,
    count: int,
    fine: Sequence[int] = (),
    **options: Any,
  ):
    """Makes the actor; arguments as of `RNNModel`, and the columns of `policy.About.fine`."""
    super().__init__(seen, dict(sets), name, count, **options)  # pyright: ignore
    self.fine = list(fine)
    self.rnn = RNN(self.obs_dim + len(self.fine), self.latent_dim, type="gru")

  def sense(self, seen: TensorDict) -> torch.Tensor:
    """Returns what goes into the memory  (..., n)."""
    flat = torch.cat([seen[group] for group in self.obs_groups], dim=-1)
    return torch.cat([self.obs_normalizer(flat), (flat[..., self.fine] / FINE).tanh()], dim=-1)

  def get_latent(
    self, obs: TensorDict, masks: torch.Tensor | None = None, hidden_state: Any = None
  ) -> torch.Tensor:
    """See `RNNModel`."""
    return self.rnn(self.sense(obs), masks, hidden_state).squeeze(0)


class Seeing(Sensing):
  """One with an encoder."""

  def __init__(self, *args: Any, size: Sequence[int], **options: Any):
    """Makes the actor; arguments as of `Sensing`, and the height and width of pictures."""
    super().__init__(*args, **options)
    self.encoder = Encoder(size)
    self.rnn = RNN(self.rnn.rnn.input_size + SAID, self.latent_dim, type="gru")

  def sense(self, seen: TensorDict) -> torch.Tensor:
    """See `Sensing`."""
    return torch.cat([super().sense(seen), self.encoder(seen[PICTURES])], dim=-1)
