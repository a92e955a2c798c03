"""The stability suite: the cases of every folder, run by one command.

================  ==============================================================
module            owns
================  ==============================================================
``suite``         which modules hold cases; running and showing them
``messages``      messages in pieces, and above 2 GiB (``exchange``: its ranks)
``inequalities``  the conditions of the performance model
``prediction``    the recurrence of the prediction
================  ==============================================================
"""
