"""Searching the rows of an expert database."""

from torchrl_rad.retrieval.goals import GoalReward
from torchrl_rad.retrieval.sampler import RetrievalSampler
from torchrl_rad.retrieval.search import ScanIndex, TreeIndex, similarity

__all__ = ["GoalReward", "RetrievalSampler", "ScanIndex", "TreeIndex", "similarity"]
