"""A whole line on virtual time: stories of units and operators, judged by what each unit bears."""
