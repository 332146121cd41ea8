"""What a candidate must reach to be named as a cause, and a set of causes to be an explanation."""

# Significance (sigma) that an estimate must have where the data differ from the accepted causes,
# instead of `SIGNIFICANT`,
MIN_SIGMA_IN_GAP = 1.5
MIN_SIGMA_WEAK = 1.0  # and when no candidate is significant: even a weak one may be true
SIMILAR = 0.7  # largest fraction of a candidate's significance that other effects may produce
MIN_LOGLIK_GAIN = 5.0  # least rise of the log-likelihood of held-out data for an effect,
MIN_LOGLIK_GAIN_WEAK = 12.0  # and for a candidate of low significance
# relative error of an effect's law: a second cause needs evidence that another law of the first
# would not produce
LAW_ERROR = 0.25
MAX_RESIDUAL_GAP = 0.15  # residual gap above which an unknown cause is assumed
MIN_GAP_CLOSED = 0.1  # fraction of the gap that a doubtful cause must close,
# and every cause, as a fraction of the residual gap; where an unknown cause is assumed: all of it
MIN_SHARE_OF_RESIDUAL = 0.25
# fraction that all candidates must close for a search beyond the first round
MIN_JOINT_GAP_CLOSED = 0.5
EXPLAINED = 0.15  # largest residual gap that is called explained,
MAX_RESIDUAL_SHARE = 0.25  # and largest residual share of any one statistic that deviates by more
MAX_RESIDUAL_SIGMA = 6.0  # than these standard deviations: simulated effects may leave less
