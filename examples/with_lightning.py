"""A model in Lightning: pip install lightning; then python examples/with_lightning.py LOG."""

import sys

import lightning
import torch

import offbeat as ob


class Corrected(lightning.LightningModule):
    """The last observed value of each channel, and what a recurrent network adds to it."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.gru = torch.nn.GRU(2 * channels, 32, batch_first=True)
        self.head = torch.nn.Linear(32, channels)

    def training_step(self, batch: ob.Batch, _: int) -> torch.Tensor:  # noqa: D102
        last = ob.last_values(batch.values, batch.mask, before=torch.zeros(()))
        since = ob.delta(batch.times, batch.mask).to(last)  # s, since each channel was observed
        hidden, _ = self.gru(torch.cat([last, since], dim=2))
        return ((last + self.head(hidden) - batch.values) ** 2)[batch.targets].mean()

    def configure_optimizers(self) -> torch.optim.Optimizer:  # noqa: D102
        return torch.optim.Adam(self.parameters(), lr=3e-3)


if __name__ == "__main__":
    log = ob.windows(ob.read(sys.argv[1]), 100, cut="consecutive")
    scaler = ob.Scaler.fit("robust", log)
    loader = ob.data_loader(log, batch_size=16, shuffle=True, scaler=scaler)
    lightning.Trainer(max_epochs=3).fit(Corrected(log.channels), loader)
