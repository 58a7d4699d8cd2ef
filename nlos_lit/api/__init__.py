"""The project from Python, as :func:`nlos_lit.load` opens it: a capture file, and what comes of it."""
