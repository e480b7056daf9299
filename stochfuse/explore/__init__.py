"""The page in a browser: move a number, and see what it does to the error.

`state` is what is asked (pure: scenario, command, Python, file), `answers` what is answered, the quick engines first
and the exact ones behind them, `network` where links and agents are drawn, `charts` the figures, `page` the fields of
one window and what happens in it, `serve` the server.  The page is Bokeh's own: its widgets have labels and its server
is all that is needed, so that Panel, which would be loaded on top of it, is not.  Numbers are those of the command
line, by the same functions.  A new thing to ask is a field of `PageInput`, its place in `PageInput.options`, and a
widget in `page`.
"""
