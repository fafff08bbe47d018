"""Holding poses against a BOP dataset: judged picture by picture, then figures, files and pictures of the result."""
