"""Commands that measure speed, endurance, accuracy, and the information in tactile data.

The option `--help` of each command describes the command.
"""

import experiments as experiments  # what Ctrl-C does, and the variables of the environment
