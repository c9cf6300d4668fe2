var t=()=>performance.timeOrigin+performance.now(),r=class extends Error{},a=e=>e instanceof Error?e.message||e.name:String(e);export{t as a,r as b,a as c};
