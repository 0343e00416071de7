# %% [markdown]
# # Read a log and look at it
#
# The log is that of a simulated arm: joints report at 100 Hz, an inertial unit at 200 Hz, a
# gripper at 20 Hz, and each drops out at times. Put the name of a file of your own instead:
# [formats](../readers.md).

# %%
import offbeat as ob
from offbeat.data import arm_log
from offbeat.plots.figures import save
from offbeat.plots.log import log as draw_log

arm_log.write("arm.csv", 20, seed=0)
log = ob.read("arm.csv")
print(log)

# %% [markdown]
# Rows are the union of all stamps, so that none is moved. A value is observed, or it is NaN: most
# are NaN, because the sensors never report at the same time.

# %%
first = log[0]
for name, unit, column in list(zip(first.names, first.units, first.observed.T, strict=True))[::6]:
    print(f"{name:18} [{unit:5}] {column.sum():5} of {first.rows} rows")

# %% [markdown]
# What was found while reading and in the values, in sentences:

# %%
inspection = ob.inspect(log)
for sentence in (*inspection.found, *inspection.notes):
    print("-", sentence)

# %% [markdown]
# What was measured when. `offbeat inspect arm.csv --out inspect.png` draws the same.

# %%
save(draw_log(log, inspection), "inspect.png")

# %% [markdown]
# In pandas, times are the index, and what was not measured is NaN.

# %%
table = ob.to_pandas(first)
print(table[["joint_1_position", "gyro_x", "gripper_force"]].head(8).round(3))
