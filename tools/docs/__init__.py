"""The documentation as a site: generated pages, links, the check of the built site."""
