"""Rivals of a policy: networks on the last value held, without and with the time since then."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

import offbeat as ob
from offbeat.data.trajectory import ACTION


class Held(nn.Module):
    """A perceptron of the last value of every channel.

    Args:
        data: that it is made for.
        width: units of its two layers.
        delta: whether it also gets the time since each channel was observed, cut off at `longest`.
        longest: s.
    """

    def __init__(
        self, data: ob.DataInfo, width: int = 100, delta: bool = False, longest: float = 1.0
    ) -> None:
        super().__init__()
        acts = torch.tensor([role == ACTION for role in data.roles])
        self.register_buffer("acts", acts, persistent=False)
        self.delta, self.longest = delta, longest
        inputs = int((~acts).sum()) * (2 if delta else 1)
        self.layers = nn.Sequential(
            nn.Linear(inputs, width),
            nn.Tanh(),
            nn.Linear(width, width),
            nn.Tanh(),
            nn.Linear(width, int(acts.sum())),
            nn.Tanh(),
        )

    def forward(self, batch: ob.Batch) -> ob.Prediction:
        """The action of each row, after the observation of that row; observations stay held."""
        zeros = torch.zeros(batch.channels, device=batch.values.device)
        before = ob.last_values(batch.values, batch.mask, before=zeros)
        held = torch.where(batch.mask, batch.values, before)
        inputs = held[..., ~self.acts]
        if self.delta:
            since = torch.where(batch.mask, 0.0, ob.delta(batch.times, batch.mask))
            since = (since.clamp_max(self.longest) / self.longest).to(inputs.dtype)
            inputs = torch.cat([inputs, since[..., ~self.acts]], dim=-1)
        mean = before.index_copy(-1, torch.nonzero(self.acts)[:, 0], self.layers(inputs))
        return ob.Prediction(mean)


ob.register_model("held", Held, replace=True)

RIVALS: dict[str, tuple[str, dict[str, Any]]] = {
    "MLP, last value": ("held", {}),
    "MLP, last value and time since": ("held", {"delta": True}),
    "GRU, every step": ("gru", {"update_rows": "every", "time_input": "none"}),
    "GRU, gap": ("gru", {}),
    "GRU-D": ("gru_d", {}),
    "ODE-RNN": ("ode_rnn", {}),
    "ODE-GRU-D": ("ode_gru_d", {}),
    "anchored": ("anchored_ode_gru_d", {}),
}
"""Name to a model and its options. The expert on held values is in every table, too."""

FIELDS = {"field_units": (50, 50)}
"""Of the models with a vector field, all alike."""


def options_of(name: str, decoder_units: tuple[int, ...]) -> tuple[str, dict[str, Any]]:
    """The model of a rival, and its options.

    Args:
        name: of `RIVALS`.
        decoder_units: of networks other than the perceptrons.
    """
    model, options = RIVALS[name]
    decoder = {} if model == "held" else {"decoder_units": decoder_units}
    return model, {**options, **decoder, **(FIELDS if "ode" in model else {})}
