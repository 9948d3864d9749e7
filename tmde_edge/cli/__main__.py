import sys

from tmde_edge.cli import main

sys.exit(main())
