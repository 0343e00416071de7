"""Policies: models that act, cloned from demonstrations at uneven times."""

from offbeat.data.drops import Drops
from offbeat.policies.demonstrations import demonstrate
from offbeat.policies.fitting import CloneConfig, fit_policy
from offbeat.policies.onnx import OnnxPolicy, export_policy
from offbeat.policies.policy import Policy
from offbeat.policies.rollouts import Controller, HeldController, Rollouts, rollout

__all__ = [
    "CloneConfig",
    "Controller",
    "Drops",
    "HeldController",
    "OnnxPolicy",
    "Policy",
    "Rollouts",
    "demonstrate",
    "export_policy",
    "fit_policy",
    "rollout",
]
