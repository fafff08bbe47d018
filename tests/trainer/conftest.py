import os
import sys
from pathlib import Path

# Spinning threads slow everything down where tests share the cores; read when torch is first imported.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import torch
from hypothesis import settings

# Rendering processes import the synthetic sampler by name.
sys.path.insert(0, str(Path(__file__).parent))

torch.set_num_threads(1)

# The first example pays for torch's start.
settings.register_profile("torch", deadline=None, max_examples=50)
settings.load_profile("torch")
