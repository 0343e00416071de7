"""The numbers of the thesis' tables 3.1 to 3.8, as it prints them.

Source: the Master's thesis *Ordinary Differential Equations Based Model for Robot Trajectories
Learning on Irregular Time Series*, chapter 3. Nothing here is corrected; `SLIPS` says where the
thesis disagrees with itself.
"""

from __future__ import annotations

MODELS = ("gru", "gru_d", "ode_rnn", "ode_gru_d")
"""In the order of the rows of its tables."""

FRACTIONS = (0.9, 0.7, 0.5, 0.3)
"""Observed fractions of the rows, in the order of the columns of tables 3.5 to 3.8."""

EPOCHS = (50, 100, 150, 200, 250, 300)
"""Columns of tables 3.1 to 3.4."""

CURVE_TABLES = {0.9: "3.1", 0.7: "3.2", 0.5: "3.3", 0.3: "3.4"}
CURVE_FIGURES = {0.9: "3.3", 0.7: "3.4", 0.5: "3.5", 0.3: "3.6"}
BOX_FIGURES = {0.9: "3.7", 0.7: "3.8", 0.5: "3.9", 0.3: "3.10"}

REPEATS = 10
"""Of each model and fraction in experiment 2 (section 3.3)."""

CHOSEN_EPOCHS = {0.9: 75, 0.7: 50, 0.5: 50, 0.3: 50}
"""The epochs that experiment 1 led to (section 3.2)."""

ALPHA = 0.05
"""Significance level (section 3.4)."""

VALIDATION_MSE: dict[float, dict[str, tuple[float, ...]]] = {
    0.9: {
        "gru": (0.00235, 0.00189, 0.00181, 0.00199, 0.00167, 0.00171),
        "gru_d": (0.00225, 0.00211, 0.00191, 0.00197, 0.00169, 0.00169),
        "ode_rnn": (0.00147, 0.00141, 0.00137, 0.00133, 0.00143, 0.00141),
        "ode_gru_d": (0.00133, 0.00132, 0.00129, 0.00137, 0.00129, 0.00137),
    },
    0.7: {
        "gru": (0.00546, 0.00493, 0.00491, 0.00509, 0.00443, 0.00464),
        "gru_d": (0.00545, 0.00467, 0.00461, 0.00546, 0.00458, 0.00422),
        "ode_rnn": (0.00411, 0.00407, 0.00406, 0.00393, 0.00394, 0.00403),
        "ode_gru_d": (0.00401, 0.00368, 0.00401, 0.00369, 0.00396, 0.00405),
    },
    0.5: {
        "gru": (0.00938, 0.00876, 0.00848, 0.00883, 0.00786, 0.00778),
        "gru_d": (0.00808, 0.00751, 0.00778, 0.00761, 0.00734, 0.00719),
        "ode_rnn": (0.00692, 0.00684, 0.00687, 0.00659, 0.00666, 0.00685),
        "ode_gru_d": (0.00688, 0.00655, 0.00677, 0.00653, 0.00671, 0.00669),
    },
    0.3: {
        "gru": (0.01465, 0.01373, 0.01290, 0.01391, 0.01225, 0.01198),
        "gru_d": (0.01234, 0.01308, 0.01225, 0.01326, 0.01319, 0.01168),
        "ode_rnn": (0.01026, 0.01011, 0.01005, 0.01012, 0.00995, 0.01018),
        "ode_gru_d": (0.01041, 0.01004, 0.00989, 0.00971, 0.00995, 0.01011),
    },
}
"""Tables 3.1 to 3.4: validation MSE by observed fraction and model, at `EPOCHS`."""

TEST_MSE: dict[str, tuple[float, ...]] = {
    "gru": (0.00165, 0.00465, 0.00781, 0.01198),
    "gru_d": (0.00163, 0.00421, 0.00721, 0.01168),
    "ode_rnn": (0.00140, 0.00404, 0.00687, 0.01018),
    "ode_gru_d": (0.00136, 0.00401, 0.00671, 0.01010),
}
"""Table 3.5: test MSE after 300 epochs, at `FRACTIONS`."""

TEST_RMSE: dict[str, tuple[tuple[float, float], ...]] = {
    "gru": ((0.0458, 0.0015), (0.0759, 0.0053), (0.0936, 0.0024), (0.117, 0.0034)),
    "gru_d": ((0.0461, 0.0016), (0.0738, 0.0013), (0.0926, 0.0025), (0.1127, 0.003)),
    "ode_rnn": ((0.0366, 0.0011), (0.0636, 0.0013), (0.0829, 0.0008), (0.1019, 0.0006)),
    "ode_gru_d": ((0.0369, 0.001), (0.0631, 0.0004), (0.0820, 0.0004), (0.1012, 0.0004)),
}
"""Table 3.6: mean and standard deviation of the test RMSE over 10 repeats, at `FRACTIONS`."""

SHAPIRO_P: dict[str, tuple[float, ...]] = {
    "ode_rnn": (0.3081, 0.2659, 0.8563, 0.9724),
    "ode_gru_d": (0.0638, 0.9261, 0.8953, 0.1214),
}
"""Table 3.7: p of the Shapiro-Wilk test on the test RMSE, at `FRACTIONS`."""

TEST_P: dict[str, tuple[float | None, ...]] = {
    "bartlett": (0.9576, 0.0012, 0.0480, 0.2910),
    "two_sample_t": (0.4557, None, None, 0.0041),
    "welch": (None, 0.2899, 0.0088, None),
}
"""Table 3.8: p of the tests of ODE-RNN against ODE-GRU-D, at `FRACTIONS`; None where it has -."""

SLIPS: dict[str, str] = {
    "3.4": "The table has ODE-RNN ahead of ODE-GRU-D at epoch 50; the text that lists where "
    "ODE-RNN is ahead leaves this out.",
    "3.8": "For the means at 90 % the text quotes p = 0.9576, which is Bartlett's; the table's "
    "0.4557 is meant.",
}
"""By table: where the thesis disagrees with itself."""

CONCLUSIONS: dict[str, str] = {
    "1": "ODE-based models are notably better than GRU and GRU-D at every observed fraction.",
    "2": "ODE-GRU-D converges in fewer epochs than ODE-RNN.",
    "3": "At 90 % ODE-RNN has the lower mean error; at 70, 50 and 30 % ODE-GRU-D has.",
    "4": "ODE-GRU-D is the most stable model: its errors spread least between repeats.",
    "5": "ODE-GRU-D is significantly better than ODE-RNN at 50 and 30 %, and at 90 and 70 % the "
    "difference is not significant.",
    "3.2": "75 epochs at 90 %, and 50 epochs otherwise, are enough.",
    "3.2, GRU": "At 90 % GRU and GRU-D are about equally good.",
}
"""What the thesis concludes (its chapter Conclusions, by number, and section 3.2), reworded."""
