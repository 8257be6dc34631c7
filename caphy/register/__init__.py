"""From labelled scans of a dressed person to the body under the clothes and the garments' templates."""
