"""The eight families of everyday objects, one module each. `objects.procedural` lists them.

The function `parts` of a family draws random dimensions and colours, and returns the parts of an object in millimetres.
Objects with a front, such as a lens or keys, face -y.
"""
