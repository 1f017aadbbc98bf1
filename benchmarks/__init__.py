"""Commands that measure speed, endurance, accuracy and the information in touch. `--help` describes each of them."""
