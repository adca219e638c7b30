"""Policies on robots: episodes, their safety, and recordings of what happened.

``runner`` runs tasks as episodes (``session``, ``episode``, ``control_loop``). ``control`` is what
commands the arm, ``recording`` what writes episodes to files and reads them back.
"""
