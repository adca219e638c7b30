"""The documentation as a site: the pages that are generated, links, and the check of what was built."""
