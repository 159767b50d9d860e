"""Every byte at rest and every path: the content-addressed store, bake caches, frames and network weights."""
