"""Policies that ship with the package, one folder each: `daedalus evaluate --pretrained NAME`."""
