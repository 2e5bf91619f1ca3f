// The order of names: the daemon's own (natural_order in src/pipeline/input/source.rs). tests/natural_order.txt holds both to it.

/** Compares names with their runs of digits as numbers, however long; equal numbers with fewer zeros in front come first. */
export function natural(a, b) {
  const [left, right] = [a, b].map(text => text.match(/\d+|\D/gu) ?? []);
  const shared = Math.min(left.length, right.length);
  for (let i = 0; i < shared; i++) {
    const compared = isNumber(left[i]) && isNumber(right[i])
      ? byValue(withoutZeros(left[i]), withoutZeros(right[i]))
      : left[i].codePointAt(0) - right[i].codePointAt(0);
    if (compared !== 0) return compared;
  }
  // Only leading zeros still differ, and these are ASCII, so counting characters equals counting bytes.
  return left.length - right.length || a.length - b.length || byText(a, b);
}

const isNumber = run => /^\d/.test(run);
const withoutZeros = run => run.replace(/^0+/, '');
const byValue = (a, b) => a.length - b.length || byText(a, b);
const byText = (a, b) => a < b ? -1 : Number(a > b);
