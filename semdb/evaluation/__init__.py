"""How well does it localize: protocols, metrics, baselines, tables, plots and reports. See docs/evaluation.md."""
