"""The documentation as a site: pages that are generated, links, the check of what was built."""
