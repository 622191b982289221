"""The service: one database over HTTP, for many robots and for pages. Thin over `semdb.api`.

`semdb serve` starts it; the web stack is in the extra ``serve`` and imported when it is needed.
"""
