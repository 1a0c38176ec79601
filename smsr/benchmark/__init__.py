"""Accuracy, time and memory on public evaluation sets, beside the published figures."""

from smsr.benchmark import camera_paths
from smsr.benchmark.datasets import DATASETS, Dataset, load, select
from smsr.benchmark.measure import (
    BenchmarkFailed,
    Environment,
    Measurement,
    environment,
    measure,
    run,
)
from smsr.benchmark.published import METHODS, PUBLISHED, Figure, best_published

__all__ = [
    "DATASETS",
    "METHODS",
    "PUBLISHED",
    "BenchmarkFailed",
    "Dataset",
    "Environment",
    "Figure",
    "Measurement",
    "best_published",
    "camera_paths",
    "environment",
    "load",
    "measure",
    "run",
    "select",
]
