"""Run on some ranks by test_balance.py: a run whose plan is another one for every frame."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

from splatpipe.cluster.balance import balancer
from splatpipe.cluster.run import run_command
from test_balance import Restless

balancer.Balancer = Restless
sys.exit(run_command(Path(sys.argv[1]), sys.argv[2:], None))
