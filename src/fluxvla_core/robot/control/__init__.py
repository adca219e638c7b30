"""Control of an arm: clock, chunk joining, action filters, limits, stops.

Nothing in it imports policies, pictures, tasks or recordings; an import contract keeps it so.
"""
