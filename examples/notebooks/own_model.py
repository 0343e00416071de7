# %% [markdown]
# # A model of your own
#
# A model is a `torch.nn.Module` whose `forward(batch)` returns a `Prediction`. Registered, it is
# fitted, scored, saved and compared as the others are.

# %%
import numpy as np
import torch

import offbeat as ob
from offbeat.data.batch import delta


class LastAndTime(torch.nn.Module):
    """The last value of each channel, and a learned correction by the time since then."""

    def __init__(self, data, width=16):
        super().__init__()
        self.mean = torch.tensor(data.statistics.mean)
        self.gap = data.statistics.median_gap
        self.correct = torch.nn.Sequential(
            torch.nn.Linear(2 * data.channels, width),
            torch.nn.Tanh(),
            torch.nn.Linear(width, data.channels),
        )

    def forward(self, batch):
        last = ob.last_values(batch.values, batch.mask, before=self.mean)
        since = delta(batch.times, batch.mask).to(last.dtype) / self.gap
        return ob.Prediction(last + self.correct(torch.cat([last, torch.tanh(since / 4)], dim=-1)))


ob.register_model("last_and_time", LastAndTime, recipe={"epochs": 15, "learning_rate": 0.01})

# %% [markdown]
# Pendulums of several lengths, half of whose rows are observed:

# %%
random = np.random.default_rng(0)
logs = []
for _ in range(120):
    times = np.cumsum(random.exponential(0.1, 60))
    rate, phase = random.uniform(2, 4), random.uniform(0, 6)
    swing = np.stack([np.sin(rate * times + phase), rate * np.cos(rate * times + phase)], axis=1)
    logs.append(ob.Trajectory(times, swing, names=("angle", "speed"), units=("rad", "rad/s")))
train, validation, test = ob.split(ob.mask_out(ob.Dataset(tuple(logs)), 0.5, seed=0), seed=0)

# %%
own = ob.make_model("last_and_time", train, seed=0)
ob.fit(own, train, validation, progress=False)
anchored = ob.make_model("anchored_ode_gru_d", train, seed=0)
ob.fit(anchored, train, validation, ob.TrainConfig(epochs=10), progress=False)
print(ob.evaluate({"last_and_time": own, "anchored_ode_gru_d": anchored}, test).table())

# %% [markdown]
# The same calls answer: a forecast in the units of the log, and files that are loaded again
# without running anything in them.

# %%
ahead = ob.forecast(own, test, 0.1)[0]
print(dict(zip(ahead.names, ahead.values[0].round(3).tolist(), strict=True)))
own.save("runs/own")
again = ob.load_model("runs/own")
print(np.array_equal(ob.predict(again, test)[0].values, ob.predict(own, test)[0].values))
