import sys
from pathlib import Path

# Rendering processes import the synthetic sampler by name.
sys.path.insert(0, str(Path(__file__).parent))
