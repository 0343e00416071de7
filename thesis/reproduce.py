"""The thesis' protocol as a plan of `offbeat.sweeps`."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar, cast

from offbeat import Dataset, ModelConfig, Scaler, TrainConfig
from offbeat.metrics import row_0_constant
from offbeat.models.base import BaseModel
from offbeat.sweeps import plan
from offbeat.sweeps.provenance import provenance
from offbeat.sweeps.running import SweepResult, run_plan
from thesis.fingerprint import fingerprint
from thesis.protocol import Protocol, Run, select
from thesis.record import Record


@dataclass(frozen=True)
class ThesisPlan(plan.Plan):
    """The runs of a protocol.

    Attributes:
        protocol: every number of it.
    """

    file: ClassVar[str] = "protocol.json"
    noun: ClassVar[str] = "protocol"
    record: ClassVar[type[Record]] = Record

    protocol: Protocol

    def runs(self) -> tuple[plan.Run, ...]:
        """Those of the protocol."""
        return self.protocol.runs()

    def settings(self) -> Mapping[str, Any]:
        """Every number of the protocol."""
        return asdict(self.protocol)

    def simulate(self, *, progress: bool) -> Dataset:
        """Hopper, as in the protocol."""
        return self.protocol.simulate(progress=progress)

    def parts(self, recorded: Dataset, run: plan.Run) -> plan.Parts:
        """Of one fraction and repeat of an experiment."""
        return self.protocol.cut(recorded, cast(Run, run))

    def scaler(self, recorded: Dataset, train: Dataset) -> Scaler:
        """Fitted on all trajectories, as the thesis does."""
        return Scaler.fit(self.protocol.scaler, recorded)

    def model_config(self, label: str) -> ModelConfig:
        """See the protocol."""
        return self.protocol.model_config(label)

    def train_config(self, run: plan.Run) -> TrainConfig:
        """See the protocol."""
        return self.protocol.train_config(cast(Run, run))

    def steps(self, run: plan.Run) -> int:
        """Epochs times batches."""
        return self.protocol.steps(cast(Run, run))

    def draw(self, run: plan.Run) -> Hashable:
        """The seed, and the fraction."""
        return run.seed_draw, cast(Run, run).observed_fraction

    def fingerprint(self, recorded: Dataset) -> str:
        """That of version 0.1.0, by which the record names its data."""
        return recorded.fingerprint(version=1)

    def provenance(self) -> dict[str, str]:
        """As the record names it."""
        return provenance_here()

    def columns(
        self, run: plan.Run, model: BaseModel, test: Dataset, recorded: Dataset
    ) -> dict[str, Any]:
        """The constant c of the masked first rows, their fraction, and the simulator."""
        batch = model.batch(test)
        masked = ~batch.mask[:, 0].any(dim=1)
        return {
            "row_0_constant": row_0_constant(batch),
            "hidden_rows_0_share": float(masked.double().mean()),
            "mujoco": str(recorded.meta.get("versions", {}).get("mujoco", "unknown")),
        }


def provenance_here() -> dict[str, str]:
    """Provenance of this process at the first call."""
    if not _HERE:
        found = provenance(fingerprint())
        _HERE.update({("kernel_body" if k == "scan_backend" else k): v for k, v in found.items()})
    return dict(_HERE)


_HERE: dict[str, str] = {}


def reproduce(
    protocol: Protocol, out: str | Path, *, only: str | None = None, **options: Any
) -> SweepResult:
    """Does the runs of a protocol that are not done yet, and keeps a record of them.

    Args:
        protocol: what to do.
        out: folder for data, runs and the record.
        only: a filter such as `experiment=1,model=ode_rnn`.
        **options: of `offbeat.sweeps.running.run_plan`.

    Raises:
        InputError, DivergenceError, OffbeatError: as `run_plan`.
    """
    return run_plan(ThesisPlan(protocol), out, asked=select(protocol.runs(), only), **options)
