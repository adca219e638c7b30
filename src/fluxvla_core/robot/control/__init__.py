"""Control of an arm: clock, chunk joining, action filters, limits, stops.

Nothing in it knows of policies, pictures, tasks or recordings; an import contract keeps it so.
"""
