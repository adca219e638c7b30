"""The contracts between the core and its plugins, as base classes: one module for each subject."""
