"""Policies on robots: episodes, their safety, and recordings of what happened.

``runner`` runs tasks as episodes (``engine``, ``episode``); in one, ``control_loop`` commands the
arm and ``inference`` queries the policy. ``control`` has the parts of the former, which on a robot
run in a process of their own (``process``); ``recording`` writes episodes to files and reads them
back.
"""
