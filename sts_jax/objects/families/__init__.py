"""The eight families of everyday objects, listed by `objects.procedural`.

The function `parts` of a family draws random dimensions and colours, and returns the parts of an object in millimetres.
If an object has a front, such as the lens of a camera or the buttons of a mouse, the front faces -y.
"""
