"""Policies on robots: episodes, their safety, and recordings of what happened.

``runner`` runs tasks as episodes (``session``, ``episode``, ``control_loop``, ``supervisor``).
``control`` commands the arm, on a robot in a process of its own (``process``); ``recording`` writes
episodes to files and reads them back.
"""
