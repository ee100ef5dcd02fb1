"""Learned particle simulators: data, models, training, rollout, comparison. Never imports taichi."""
