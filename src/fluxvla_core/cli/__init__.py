"""The command line: ``fluxvla`` and its commands; each is imported only when it is called."""
