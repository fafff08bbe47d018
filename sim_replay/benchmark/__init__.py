"""The benchmark: datasets made from a preset and a seed, their statistics, and how fast they are made."""
