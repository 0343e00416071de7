# %% [markdown]
# # Compare models on a hopper at uneven times
#
# A hopper falls; 30 % of its rows are observed. All models see the same windows and masks, and
# the last observed value is in every table.

# %%
import offbeat as ob

recorded = ob.simulate("hopper", 300, rows=200, seed=0, progress=False)
data = ob.mask_out(ob.windows(recorded, 100, seed=0), 0.3, seed=0)
train, validation, test = ob.split(data, seed=0)
print(train)

# %% [markdown]
# Two models, trained for a few epochs: GRU-D, and an anchored model whose vector field moves the
# values themselves.

# %%
models = {}
for name in ("gru_d", "anchored_ode_gru_d"):
    models[name] = ob.make_model(name, train, seed=0)
    ob.fit(models[name], train, validation, ob.TrainConfig(epochs=8), progress=False)
print(ob.evaluate(models, test).table())

# %% [markdown]
# After so few epochs GRU-D is far behind the last value. The error per channel, in its unit: the
# anchored model is behind the last value in `rootx_qvel`.

# %%
print(ob.evaluate(models, test).in_units().table())

# %% [markdown]
# Models that were trained for longer come with the package. They have scalers of their own, so
# each is scored by itself.

# %%
shipped = ob.load_model("offbeat/hopper-anchored-large")
print(ob.evaluate({"hopper-anchored-large": shipped}, test).table())

# %% [markdown]
# [Sweeps](../sweeps.md) train models with several seeds, and [tests of
# significance](../statistics.md) say which differences are more than chance: one seed, as here,
# is not a result.
