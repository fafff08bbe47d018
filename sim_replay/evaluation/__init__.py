"""Compares poses with the ground truth of a BOP dataset, image by image; figures, files and plots of the result."""
