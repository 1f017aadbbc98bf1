"""The two compiled programs of `sense`: `equilibrium` balances an object on the gel, and `drawing` draws the images."""
