/* Scores of the search: those of Sphinx, but pages that list everything come last, except by their titles. */
const LISTS = new Set([
  "reference/benchmarks",
  "reference/bibliography",
  "reference/changelog",
  "reference/renames",
]);

var Scorer = {
  score: ([docname, title, anchor, descr, score, filename, kind]) =>
    LISTS.has(docname) && kind === "text" ? score - 100 : score,
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
