// Order of the search results: pages for a task before those to look something up.
var Scorer = {
  score: ([name, , , , score]) => score + (name.startsWith("reference/") ? -20 : 0) + (name.startsWith("how-to/") ? 20 : 0),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
