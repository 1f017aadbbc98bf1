"""The eight families of everyday objects, one module each. `objects.procedural` lists them.

The function `parts` of a family draws dimensions and colours and returns the parts in millimetres. An object with a
front (lens, keys) faces -y.
"""
