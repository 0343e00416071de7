# %% [markdown]
# # Fill and forecast, with intervals
#
# `learn` needs a log alone. Here its models are given and small, so that this page is made in
# seconds; leave out all that follows the folder, and a few models are tried for some minutes.

# %%
import numpy as np

import offbeat as ob
from offbeat.data import arm_log
from offbeat.plots.figures import save
from offbeat.plots.spans import Span, spans

arm_log.write("arm.csv", 15, seed=0, outage_s=0)
log = ob.read("arm.csv").select(("joint_2_position", "joint_2_velocity", "joint_2_effort"))
learned = ob.learn(
    log,
    "runs/arm",
    horizon_s=0.3,
    model="anchored_trend",
    training=ob.TrainConfig(epochs=3, tasks_per_epoch=100),
    baselines=["last_value", "damped_slope", "linear", "pchip", "smoother"],
    progress=False,
)
blend = learned.blend

# %% [markdown]
# The blend answers for another recording, of which only what was measured is known. In this one,
# what the sensors would have reported in their dropouts is kept beside it, to compare with.

# %%
(new,) = ob.Dataset((arm_log.with_hidden_values(10, seed=1, outage_s=0),)).select(blend.names)
filled = ob.impute(blend, ob.Dataset((new,)))[0]
hidden = np.isfinite(new.values) & ~new.observed
low, high = filled.interval(0.9)
inside = (new.values >= low) & (new.values <= high)
for i, (name, unit) in enumerate(zip(new.names, new.units, strict=True)):
    error = np.sqrt(np.mean((filled.values - new.values)[hidden[:, i], i] ** 2))
    held = 100 * inside[hidden[:, i], i].mean()
    print(f"{name}: RMSE {error:.3g} {unit} in dropouts, {held:.0f} % in the interval of 90 %")

# %% [markdown]
# Nearly all values lie in the intervals of 90 %, so here they are wider than they should be.
#
# A forecast is for any time after the last row. `beyond` would mark answers for longer times than
# were trained.

# %%
now = 4.0
past = new.slice(0, int(np.searchsorted(new.times, now)))
ahead = ob.forecast(blend, ob.Dataset((past,)), np.linspace(0.01, 0.3, 30))[0]
low, high = ahead.interval(0.9)
print(f"in {ahead.times[-1] - now:.1f} s: {ahead.values[-1, 0]:.3f} rad,", end=" ")
print(f"90 % between {low[-1, 0]:.3f} and {high[-1, 0]:.3f} rad")

# %% [markdown]
# Both in a figure: the dropout in which the joint moves most, and the forecast. Grey dots were not
# seen.

# %%
out = np.flatnonzero(hidden[:, 0])
runs = np.split(out, np.flatnonzero(np.diff(new.times[out]) > 0.05) + 1)
moving = max(runs, key=lambda run: np.ptp(new.values[run, 0]))
start, stop = new.times[moving[[0, -1]]] + [-0.005, 0.005]
end = int(np.searchsorted(new.times, now + 0.35))
unseen = new.observed & (new.times <= now)[:, None]
future = ob.Trajectory(
    new.times[:end], new.values[:end], observed=unseen[:end], names=new.names, units=new.units
)
figure = spans(
    [
        Span("A dropout, filled", new, start, stop, filled),
        Span("A forecast", future, now, now + 0.3, ahead),
    ],
    [new.names, new.names],
)
save(figure, "answers.png")
