"""Questions asked of predictions: backwards, of links, of messages.

    least_link, agents_needed      which µ, or how many agents, meet a target
    least_value                    which value of any key does
    critical                       the µ above which (54) stays bounded
    sensitivity                    what a better link is worth
    messages, message_chain        how much the agents have to send each other

`question` is what several of them have in common.  It knows predictions, and nothing of how they are shown.  A new
question is one file with one function, and a sheet in `stochfuse.report.solutions`.
"""
