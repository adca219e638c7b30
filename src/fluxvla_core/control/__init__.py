"""Control of an arm: clock, chunk joining, action filters, limits, stops.

Nothing in it imports policies, images, tasks or recordings; an import contract keeps it so.
"""
