"""The benchmark: datasets generated from a preset and a seed, their statistics, and the speed of generating them."""
