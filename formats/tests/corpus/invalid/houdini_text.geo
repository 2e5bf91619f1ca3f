[
	"fileversion","19.5.303",
	"pointcount",2
]
