"""Forecasts and fills on real logs, by every predictor on the same values.

    python -m examples.real_logs --out results/real_logs --seeds 3

`logs` reads the logs and splits them, `tasks` says what is masked and what is scored, `predictors`
has the baselines and the models, `scores` compares them, `report` writes `docs/real_logs.md`.
"""
