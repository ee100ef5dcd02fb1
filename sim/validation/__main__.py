import sys

from sim.validation.ladder import main

sys.exit(main())
