"""Policies that ship with the package, a folder each: `daedalus evaluate --pretrained NAME`."""
