"""What an acquisition holds as evidence of an effect: frames, maps, and what their fit takes up."""
